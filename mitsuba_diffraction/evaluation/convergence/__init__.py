"""Error of a picture against its time: by the tolerance of its spectra, and by the terms of the amplitude series."""
