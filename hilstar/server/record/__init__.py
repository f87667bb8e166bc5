"""What a run leaves behind: its ledger, its frames as files, its report."""
