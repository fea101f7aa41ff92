"""Tests of lightning_pose.concurrency."""
