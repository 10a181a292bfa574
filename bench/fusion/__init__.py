"""What each sense gives: outfits of a robot against what happens to it, held against the truth."""
