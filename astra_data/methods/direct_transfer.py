"""Direct transfer: a recurrent policy trained in the raw simulator and deployed unchanged (the floor)."""

from astra_data.methods.method import Method

DIRECT_TRANSFER = Method(name="direct_transfer", title="Direct transfer", color="#E69F00", role="floor")
