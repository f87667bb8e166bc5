"""The digital twin of a bench: what the tracker would measure of the stars that the monitor shows,
against the sky.

One file a step. The bench, as it believes itself to be, draws codes; the monitor, as it is, makes
light of them (`light`); collimator and tracker make an image of it, and the detector noise
(`twin`); a centroider finds stars (`star_finder`), and each is compared with itself in the image of
the sky (`measure`). The result is a `measured`, from which the data flow on to `display_errors`,
`reasons`, `verdict`, `summary` and `report`. `run` does all of it over random fields.

The same centroider on the tracker's image of the sky itself, with the sprites' width, gives the
estimator's own errors, and those are subtracted: what is left is the display's. Where the bench
differs from what it assumes, the codes are also looked at as if it did not, so that their own cost
is told from what is wrong.
"""
