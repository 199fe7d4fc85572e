"""`phantom`, `twin` and `accuracy`: images of known strain, and the errors measured on them."""
