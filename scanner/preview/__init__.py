"""The live picture of a bench: whether it is sharp, bright enough, and not too bright.

`measures` are what is read off a frame, `live` gets the frames, `canvas` draws them, and `window` or `lines` show them.
"""
