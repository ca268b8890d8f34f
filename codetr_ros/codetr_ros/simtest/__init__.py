"""A simulation of whole runs in one process, whose network, disks and processes fail by a seed."""
