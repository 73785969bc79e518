"""Recordings: written in a run's second pass, read back without a viewer or a server."""
