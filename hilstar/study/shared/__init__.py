"""What two or more studies use: stars that stand alone, predictors, ways to codes, sensors."""
