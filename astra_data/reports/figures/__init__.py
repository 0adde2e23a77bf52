"""Figures: pure functions from arrays to a matplotlib Figure, in one style.

style         colors, titles and roles of the methods; fonts and lines
scores        score_bars, learning_curves
motion        trajectories (the paper's Fig. 3), dynamics_mismatch (the paper's Fig. 1)
coverage      coverage: which positions or velocities a dataset holds
validity      predictive_validity: returns in the simulators against those in the target
reliability   reliability: whether predicted failures come true
sizes         data_efficiency: a score over the size of the dataset, and what each size covers
open_loop     open_loop_error: how fast a simulator drifts from the target
strips        strips: episodes in pictures, a strip per method
walks         walk_prediction: how well models predict a recorded walk, by horizon and size of the data
"""

from astra_data.reports.figures.coverage import coverage
from astra_data.reports.figures.motion import Panel, dynamics_mismatch, trajectories
from astra_data.reports.figures.open_loop import OpenLoop, open_loop_error
from astra_data.reports.figures.reliability import reliability
from astra_data.reports.figures.scores import Curve, learning_curves, score_bars
from astra_data.reports.figures.sizes import Scored, data_efficiency
from astra_data.reports.figures.strips import Strip, strips
from astra_data.reports.figures.style import method_color, method_title, png
from astra_data.reports.figures.validity import SimulatorReturns, predictive_validity
from astra_data.reports.figures.walks import walk_prediction

__all__ = [
    "Curve",
    "OpenLoop",
    "Panel",
    "Scored",
    "SimulatorReturns",
    "Strip",
    "coverage",
    "data_efficiency",
    "dynamics_mismatch",
    "learning_curves",
    "method_color",
    "method_title",
    "open_loop_error",
    "png",
    "predictive_validity",
    "reliability",
    "score_bars",
    "strips",
    "trajectories",
    "walk_prediction",
]
