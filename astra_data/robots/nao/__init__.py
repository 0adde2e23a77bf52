"""A simulated stand-in for the NAO V6: body, walk, batched robots, tasks."""
