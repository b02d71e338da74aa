"""The spectrum of the phase e^{iκh}: its orders, its table, its file."""
