"""Tests of lightning_pose.features."""
