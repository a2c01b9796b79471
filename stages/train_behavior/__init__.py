"""Train the behavior model from trajectories: perception, goal, path and body.

`batches` draws augmented windows in the ego frame, `objective` computes denoising losses (`baseline_losses`
those of the baselines of Table 4), `training` runs the loop, `reactions` measures reactions to the observer,
`export` writes weights, ONNX and the sampler's contract, `pictures` draws charts and checks, `outcome` writes
all results, `refusals` rejects invalid settings and data before training.

Errors: BEH-001 no window of past and horizon, REC-002 settings that cannot be trained or exported.
"""
