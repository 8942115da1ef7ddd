"""Several processes that train one model together, each with views of its own."""
