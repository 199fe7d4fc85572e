"""The command line: one file for each group of commands, the options that they share, and the program."""
