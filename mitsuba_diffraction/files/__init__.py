"""Files: whole or not at all, sealed, and overwritten only where that is allowed; pictures of users."""
