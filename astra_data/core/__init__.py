"""What every room uses: no robot and no data is known here."""
