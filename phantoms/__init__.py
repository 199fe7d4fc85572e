"""Image pairs of which the truth is known: motions, a heel's anatomy, and MR image formation."""
