"""The golden record: the figures that mrstrain gives, kept, so that code can move and change under them unseen."""
