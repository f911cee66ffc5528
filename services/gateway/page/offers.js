// What the gateway offers: heads, lip models and languages.

const RETRY_MS = 1000;

/** Load the offers. If the gateway does not answer, call onFailure and try again until it does. */
export async function loadOffers(onFailure) {
  for (;;) {
    try {
      const response = await fetch("offers.json");
      if (response.ok) return await response.json();
    } catch {
      // no connection
    }
    onFailure();
    await new Promise((resolve) => setTimeout(resolve, RETRY_MS));
  }
}
