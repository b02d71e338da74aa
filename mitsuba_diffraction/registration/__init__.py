"""Registration with Mitsuba: `import_hook` waits until it is imported, `plugins` then registers the plugins."""
