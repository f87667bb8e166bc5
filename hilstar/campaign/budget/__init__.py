"""The error budget of a star tracker: bias, field-of-view error, pixel error and noise, per axis; its clock; its wrong answers.

NumPy and SciPy only: arrays in, a `Decomposed` out. Angles in arcsec, attitudes unit q_icrs_to_cam (w, x, y, z), cam axes.

- `budget.assess_cases(commanded, reported, scale, rng[, rate_rad_s])`: independent cases, arrays (n, 4); a row of NaN in
  `reported` is a case without an answer. `Scale(focal_px, (width, height))` is the tracker's.
- `budget.assess_run(commanded, tau_s, reported, coarse, scale, rng)`: a tracker's telemetry on its own clock, against a
  `Commanded(t_s, q)`; `coarse_clock.coarse_offset(commanded, tau_s, reported)` finds where it lies on the run's clock.
- `Decomposed.bias_arcsec` (3,), `.fov_arcsec`, `.pixel_arcsec`, `.noise_arcsec` (`Axes(cross, roll)`, one sigma an axis, None
  where it cannot be told, and `.notes` say why), `.intervals` (95 %), `.wrong` and `.row` (indices of the wrong and the right
  answers), `.components.left` (k, 3), what is noise in each right answer.
"""
