"""Pure functions on poses: `quaternions` and pose errors, `relative` poses along clips, `two_view` motion."""
