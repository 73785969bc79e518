"""Planted errors: each changes one place of the sources, and names the tests of which one must then fail.

    python -m tests.mutations                  all of them, each with its own tests; resumes where it was stopped
    python -m tests.mutations NAME ...         these
    python -m tests.mutations --whole 10       ten of them, each with all tests

Outcomes are stored in `outcomes.json`, with the digests of the sources and of the table's entry that they belong to.
"""
