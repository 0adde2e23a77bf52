"""Abstract simulators: batched, `reset_to(state)`, and the wrapper that grounds them."""
