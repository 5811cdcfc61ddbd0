"""`python -m space_dist.cli`."""

from space_dist.cli import main

if __name__ == "__main__":
    main()
