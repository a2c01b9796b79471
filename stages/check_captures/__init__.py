"""Look at recordings for a minute before hours of work: what each is, how good it is, what to do better.

`looking` samples a recording, `poses` judges its device poses, `movers` looks for the animal, `overlap` places sessions
in the walk-through, `problems` turns figures into coded problems with remedies, `telling` into text.
"""
