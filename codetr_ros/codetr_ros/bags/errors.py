"""What can be wrong with a bag, and where."""


class BagError(RuntimeError):
    """A bag that cannot be read, written or set up: names the file or the type, the place, the
    reason and the remedy.
    """
