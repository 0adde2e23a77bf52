"""Abstract simulators: batched, `reset_to(state)`; and the wrappers that scatter and that ground them."""
