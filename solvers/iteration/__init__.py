"""Shared parts of the methods: objective, descent, line search, saddle points, spring forms, vertex terms."""
