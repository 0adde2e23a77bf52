"""Open-loop prediction of a real robot's recorded walk, by abstract simulators fitted to other recordings.

recordings   logs or datasets → pieces of rows, with rows that are not walking marked
motion       planar motions in the body's frame: composed, inverted, mirrored
planar_walker   the abstract simulator of a walking robot
walks        pieces → control steps, paired with the abstract simulator; stretches of them
predictors   the interface of a walk model; the raw simulator, and one gain per axis
windows      ridge regression and a feed-forward network on the last H steps
histories    ASTRA and NAS: the grounding model on motions in the body's frame
rollouts     open-loop prediction, and fitting to it
errors       errors per axis and horizon, with intervals over pieces
study        training data, models and test data of a study; resumable
page         results → Markdown and figure
run          recipe and recordings → results, page and figure
"""
