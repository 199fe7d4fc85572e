"""What every command shares: inputs read and checked, provenance, progress, and the doctor."""
