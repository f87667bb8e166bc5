"""What a campaign's table says: the error budget, and what each parameter costs."""
