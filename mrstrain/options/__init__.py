"""Options, each concern a frozen model: what command line, study file and Python take, with defaults, checks and help.

Nothing heavy is imported here: ``mrstrain COMMAND --help`` is made from these models.
"""
