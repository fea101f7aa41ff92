"""Kills, damage, full disks and other abuse: what is tried, and how often the program misbehaves.

    python -m benchmarks.abuse WHAT [--work DIR] [--times N]

`python -m benchmarks.abuse --help` lists what there is.
"""
