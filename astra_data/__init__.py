"""Robot trajectories into LeRobot datasets, and those into policies that transfer from an abstract simulator.

The house, from the ground up; a file uses only what is below it or beside it, never what is above:

words       errors  columns  seeding  recipe  batched  simulator  progress  statistics
knowledge   mazes  free_space  navigation  ant  physics  abstraction  checkpoint  models/
data        dataset/  figures/
worlds      envs/ (targets)  sims/ (abstract simulators, raw, randomized, grounded)
learning    tasks  world  training_world  learners/  gap  deployment
methods     methods/, one file each: what is different about it
stages      stages/, one file per step: collect pair ground train align evaluate report
roof        plan  schedule  run  cli
"""
