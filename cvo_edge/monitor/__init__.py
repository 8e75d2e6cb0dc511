"""What watches an odometer at work: the alarm without labels, and the adaptation to labels."""
