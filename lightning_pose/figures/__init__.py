"""Figures: `images` for single images, `clips` for clips."""
