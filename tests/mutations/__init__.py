"""Planted lies: each changes one place of the sources, and names the tests that must then fail.

    python -m tests.mutations                  all of them, each with its own tests; goes on where it was stopped
    python -m tests.mutations NAME ...         these
    python -m tests.mutations --whole 10       ten of them, each with all tests

Outcomes are kept in `outcomes.json`, with the sources and the table's entry that they belong to.
"""
