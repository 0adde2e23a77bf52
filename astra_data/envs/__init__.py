"""Target environments: batched, and registered with Gymnasium."""
