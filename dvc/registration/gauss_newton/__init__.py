"""The Gauss-Newton engine: image term, roughness prior and the sums over B-splines."""
