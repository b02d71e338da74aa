"""The checks of `mitsuba-diffraction validate`: closed forms, statistics, rigorous theory, measured gratings."""
