"""Open-loop prediction of a real robot's recordings, by abstract simulators fitted to other recordings.

recordings   logs or datasets → pieces of rows, with rows that do not count marked
body         what is predicted of a robot: its motions, what models see, its abstract simulator
motion       planar motions in the body's frame: composed, inverted, mirrored
planar_walker   the abstract simulator of a walking robot
walking      a walking body in the plane, and which rows are walking
joints       joints that are sent to targets, and their abstract simulator
sequences    pieces → control steps, paired with the abstract simulator; stretches of them
models       the models that are compared, as page and figure show them
predictors   the interface of a model; the raw simulator, and what is identified of it
windows      ridge regression and a feed-forward network on the last H steps
histories    ASTRA and NAS: the grounding model on motions
rollouts     open-loop prediction, and fitting to it
errors       errors per axis and horizon, with intervals over pieces
gap_recipe   the settings of a study
study        training data, models and test data of a study; resumable
page         results → Markdown and figure
run          recipe and recordings → results, page and figure
"""
