"""Many runs under one protocol: cells made by a spec, run by workers, read by a report."""
