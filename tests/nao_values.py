"""Values of the NAO that tests compare with."""

import numpy as np

from astra_data.robots.nao.perception import PerceptionErrors

NO_ERRORS = PerceptionErrors(*(0.0,) * 3, 2.0, 0.0, (0.0, 0.0), *(0.0,) * 4, 0.5, 0.0, np.pi, 0.0)
"""Exact estimates."""
TOTAL_MASS_KG = 5.36
