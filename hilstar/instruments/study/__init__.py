"""Charts and checks: what each choice costs, where methods fail."""
