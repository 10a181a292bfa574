"""What is looked at: boards, marks, the ceiling itself; and where its pictures come from."""
