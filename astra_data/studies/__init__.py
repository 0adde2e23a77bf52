"""Open-loop prediction of a real robot's recorded walk, by abstract simulators that learn from other records.

recordings   a folder of logs or a dataset → pieces of rows, with what is no walking marked
motion       planar motions in the body's frame: composed, seen, mirrored
walks        pieces → control steps, paired with the abstract simulator; stretches drawn from them
predictors   what a model of the walk is; the raw simulator, and one gain per axis
windows      ridge regression and a feed-forward network on the last H steps
histories    ASTRA and NAS: the grounding model, fed what the body feels
rollouts     open-loop prediction, and fitting by it
errors       errors per axis and horizon, with intervals over pieces
study        which models learn from what and are tested on what; resumable
page         the results as Markdown
"""
