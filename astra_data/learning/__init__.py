"""Policy optimisation, on any batched environment or from recorded episodes."""
