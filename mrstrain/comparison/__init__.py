"""`compare`, `drive` and `level`: models against a measurement, and the methods text."""
