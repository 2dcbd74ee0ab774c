"""Linear partial differential equations in one space dimension: read, converted to PIEs, discretised."""
