"""What every model is measured against: of single images, of clips, and classical visual odometry."""
