"""What watches an odometer at work, and corrects it: adaptation to labels."""
