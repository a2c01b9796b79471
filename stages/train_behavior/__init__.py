"""Train the behaviour model from trajectories: perception, goal, path and body.

`batches` draws augmented windows in the ego frame, `objective` turns them into denoising losses, `training` runs the
loop, `reactions` asks whether the animal minds the observer, `export` writes weights, ONNX and the sampler's contract,
`pictures` judges it all.
"""
