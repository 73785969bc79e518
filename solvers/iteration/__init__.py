"""Shared parts of the methods: iteration loop, descent, preconditioners, saddle check, vertex terms."""
