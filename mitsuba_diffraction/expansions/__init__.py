"""e^{iκh} as a short sum Σ_n c_n(κ) φ_n(h): the ways to separate the height from the wavelength."""
