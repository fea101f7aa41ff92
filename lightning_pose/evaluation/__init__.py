"""What every test ends with: `callback` runs it all, `images` and `clips` measure each kind of model."""
