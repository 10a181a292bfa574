// Asks for the token and takes a session for it.
const reply = document.getElementById("reply");

document.getElementById("login").addEventListener("submit", async (event) => {
  event.preventDefault();
  const token = document.getElementById("token").value;
  try {
    const answer = await fetch("/login", {
      method: "POST",
      headers: { "Content-Type": "application/json" },
      body: JSON.stringify({ token }),
    });
    if (answer.ok) {
      location.replace("/");
      return;
    }
    reply.textContent = answer.status === 401 ? "That is not the token." : `The server refused: ${answer.status}.`;
  } catch {
    reply.textContent = "The server does not answer.";
  }
});
