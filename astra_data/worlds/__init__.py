"""What can be stepped, and the tasks set there: target environments and abstract simulators, B at once."""
