"""A localizer behind HTTP: `app` has the addresses, `server` runs them, `static` is the page for a browser."""
