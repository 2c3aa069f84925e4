"use strict";
// The tracker's estimates as they come, for a page of the same server.
//
// follow(take, say): take(hands, line) is called with each line, hands being a record for each hand
// with what the line says of the frame as a whole; say(phase) with "connecting", "live", "waiting"
// (no line for a while) and "broken" (the tracker has gone; it is tried again).
const RETRY_MS = 1000, STALE_MS = 2000;

function handsOf(line) {
  if (!line.hands) return [line];
  const { hands, ...frame } = line;
  return hands.map((hand) => ({ ...frame, ...hand }));
}

function lostWords(hand) {
  return hand.state_name === "lost" ? "lost" : `lost (${hand.state_name})`;
}

function follow(take, say) {
  const address = new URL("/stream", location.href);
  address.protocol = location.protocol === "https:" ? "wss:" : "ws:";
  let stale = 0;
  const connect = () => {
    const socket = new WebSocket(address);
    socket.onmessage = (message) => {
      const line = JSON.parse(message.data);
      clearTimeout(stale);
      stale = setTimeout(() => say("waiting"), STALE_MS);
      say("live");
      take(handsOf(line), line);
    };
    socket.onopen = () => say("waiting");
    socket.onclose = () => {
      clearTimeout(stale);
      say("broken");
      setTimeout(connect, RETRY_MS);
    };
  };
  say("connecting");
  connect();
}
