"""Recordings, written in the instrumentation pass and read back without a viewer or a server."""
