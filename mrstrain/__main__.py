"""`python -m mrstrain`: the command line."""

from mrstrain.cli import main

main()
