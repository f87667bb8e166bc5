"""The sky: star positions, spectra and the electrons they cause in the tracker."""
