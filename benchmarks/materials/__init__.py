"""Materials and light beside Mitsuba's `principled`."""
