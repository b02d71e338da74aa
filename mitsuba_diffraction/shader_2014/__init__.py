"""The published real-time shader of structural colour, for comparison with this project's model.

Chapters 3 and 4 of the thesis of 2014 from which this project started. `quirks` and `tristimulus` do not need
Mitsuba.
"""
