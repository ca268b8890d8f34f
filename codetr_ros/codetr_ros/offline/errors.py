class FitError(ValueError):
    """Data that cannot be fitted, labelled or converted: names it, the value and the remedy."""
