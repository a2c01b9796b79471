"""Train the behaviour model from trajectories: perception, goal, path and body.

`batches` draws augmented windows in the ego frame, `objective` turns them into denoising losses
(`rival_losses` into those of the rivals of Table 4), `training` runs the loop, `reactions` asks whether the
animal reacts to the observer, `export` writes weights, ONNX and the sampler's contract, `pictures` judges it
all, `outcome` has all of this written, `refusals` rejects what cannot be learned before it is tried.

Errors: BEH-001 no window as long as is foretold, REC-002 settings of which nothing can be learned or made.
"""
