"""Damaged input by the thousand: a result or one clear error, never a traceback (`--hypothesis-profile long`)."""
