"""Cheap camera localization: a folder of posed images in, a trained and measured localizer out.

The data goes one way, and imports point along it:

- `errors`, `paths`, `geometry`: exceptions, where files are kept, quaternions and poses
- `scenes`: a folder on disk -> `Scene`
- `features`: images -> SURF and other descriptors, cached
- `data`: Scene + features -> batches
- `losses`, `metrics`, `models`: the architectures, one file each
- `localization`: a checkpoint -> poses of images
- `runs`, `figures`, `evaluation`: MLflow, and what every test ends with
- `sweeps`, `studies`, `reports`: tuning, the thesis's figures, tables of finished runs
- `cli`, `commands`: what users run
"""
