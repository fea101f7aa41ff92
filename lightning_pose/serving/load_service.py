"""Makes the server's `Service` from a localizer: what it is, its map from above, and how it answers an upload."""
