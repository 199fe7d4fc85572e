"""The report page, its figures and its viewer of volumes."""
