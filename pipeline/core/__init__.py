"""What every package stands on: coded errors, configuration, processes and threads, progress, the training
loop.
"""
