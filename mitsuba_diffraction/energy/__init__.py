"""E, the factor that bounds the albedo by one: a white furnace, and the table that it makes."""
