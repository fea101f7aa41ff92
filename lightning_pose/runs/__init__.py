"""MLflow, both ways: `logger` and `recorder` write runs, `reader` reads them."""
