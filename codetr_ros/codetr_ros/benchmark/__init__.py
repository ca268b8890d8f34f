"""Do many runs under one protocol: a spec makes cells, workers run them, a report reads them."""
