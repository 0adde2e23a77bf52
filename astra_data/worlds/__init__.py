"""Target environments and abstract simulators, stepped B at once, and the tasks that pair them."""
