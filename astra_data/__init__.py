"""Robot trajectories into LeRobot datasets, and those into policies that transfer from an abstract simulator.

The house, from the ground up; a file uses only what is below it or beside it, never what is above:

words       errors  extras  columns  layouts  seeding  recipe  rows  batched  simulator  progress  statistics
            digest  lock  cores  stopwatch  score
knowledge   geometry  mazes  free_space  objective  navigation  ant  physics  abstraction  checkpoint
            logbook  models/  recording  import_mapping  conversion  variation  planar  free_states  ball
            kicking  nao/  humanoid/
data        dataset/  inspection  grounding_file  target_encoder_file  figures/  results/  sharing/
exchange    importers/  exporters/ (one file per format of other libraries and logs)  cutting  imports
worlds      envs/ (targets)  sims/ (abstract simulators: raw, varied, scattered, grounded)
learning    task  antmaze_tasks  nao_tasks  humanoid_tasks  tasks  simulators  world  target_world
            training_world  policy_file  deployment  behaviors  suboptimal  gap  mismatch  outcome
            gymnasium_faces  pairing  relocation  replays  telemetry  descent  fitting  training
            target_training  method  learners/
methods     methods/ (one file each: what is different about it)
prediction  prediction/ (open-loop prediction of a real robot's recorded walk)
stages      stages/ (one file per step: collect augment pair subset ground train align evaluate report)
roof        request  points  plan  experiment  schedule  cluster  display  board  inspection_page  run  sweep
            walk_gap  commands/  cli
"""
