"""Policy optimisation on any batched environment, with TorchRL's losses."""
