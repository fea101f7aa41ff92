"""Cheap camera localization: a folder of posed images in, a trained and measured localizer out.

The data goes one way, and imports point along it:

- `errors`, `geometry`, `images`: exceptions, quaternions, image files
- `data.scene`, `data.formats`, `data.synthetic`: folders on disk -> `Scene`
- `features`: images -> SURF and other descriptors, cached
- `data.datamodules`: Scene + features -> batches
- `losses`, `metrics`, `models`: the architectures, one file each
- `baselines`, `plots`, `callbacks`, `tracking`: what a run is measured against, and where it is kept
- `localize`, `cli`: what users run
"""
