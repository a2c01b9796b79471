"""The behavior model: trajectories, perception, diffusion, planning and the simulator."""
