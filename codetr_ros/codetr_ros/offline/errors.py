class FitError(ValueError):
    """Data that nothing can be fitted on, or labelled with: names it, the value and the remedy."""
