"""The Mitsuba plugin `diffraction_grating`. Everything in this folder needs Mitsuba."""
