"""Policy optimization, on any batched environment or from recorded episodes."""
