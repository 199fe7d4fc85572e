"""`compare`, `drive` and `level`: comparison of models with a measurement, and the methods text."""
