"""What a campaign varies: the plan's file, the parameters that it names, and the design that spreads its cases over them."""
