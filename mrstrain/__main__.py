"""`python -m mrstrain`: the command line."""

from mrstrain.cli.app import main

if __name__ == "__main__":
    main()
