"""The real-time shader of structural colour, as it was published, beside this project's model.

Chapters 3 and 4 of the thesis of 2014 that this project starts from. `quirks`, `taylor_textures` and `tristimulus`
only precompute and need no Mitsuba; the rest does.
"""
