"""The Mitsuba plugin `diffraction_path`. Everything in this folder needs Mitsuba."""
