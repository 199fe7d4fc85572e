"""Readers of the files that a user gives, tried on damaged copies of small valid ones."""
