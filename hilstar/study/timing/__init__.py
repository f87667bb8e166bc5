"""What the timing of a screen does to a tracker on a slew, and what each compensation is worth and costs."""
