"""Baselines: of single images, of clips, and classical visual odometry."""
