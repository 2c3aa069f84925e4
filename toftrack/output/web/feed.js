"use strict";
// The tracker's estimates as they come, for the pages of the same server.
//
// follow(take): take(hands, line) is called with each line, hands being a record for each hand with
// what the line says of the frame as a whole. The phase stands in the page's body and #phase.
const RETRY_MS = 1000, STALE_MS = 2000;
const WORDS = { live: "live", waiting: "waiting for the tracker", broken: "connection lost; trying again" };
const by = (id) => document.getElementById(id);

function handsOf(line) {
  if (!line.hands) return [line];
  const { hands, ...frame } = line;
  return hands.map((hand) => ({ ...frame, ...hand }));
}

function lostWords(hand) {
  return hand.state_name === "lost" ? "lost" : `lost (${hand.state_name})`;
}

function say(phase) {
  if (document.body.dataset.phase === phase) return;
  document.body.dataset.phase = phase;
  by("phase").textContent = WORDS[phase];
}

function follow(take) {
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
  connect();
}
