"""Files of ours and of others: opened safely, read with bounds."""
