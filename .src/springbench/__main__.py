"""`python -m springbench`: the command line."""

from springbench.harness.__main__ import main

if __name__ == "__main__":
    main()
