"""Parts of the study of Table III's bias."""
