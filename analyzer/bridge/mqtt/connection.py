"""Connection to a broker that may be unavailable: values are repeated, events expire."""

import math
import ssl
import sys
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any

import paho.mqtt.client as mqtt
from paho.mqtt.enums import CallbackAPIVersion
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties
from paho.mqtt.reasoncodes import ReasonCode

from hearthlog.analyzer.bridge.settings import MqttSettings, secret_path
from hearthlog.analyzer.bridge.state import BridgeError, Report
from hearthlog.schemas.files import read_limited

_KEEPALIVE = 20  # seconds: the broker drops a client that is silent for 1.5 times as long
_QUEUED = 1000  # messages waiting for the broker, and events waiting for a connection
_KEPT_SECONDS = 0.5  # for a broker that sends retained messages after later ones
_MOST_KEPT_SECONDS = 10.0  # for a broker that retains a lot, or does not send `online` back
_ANSWER_SECONDS = 2.0  # for the broker to acknowledge an event
_TIMELY_SECONDS = 60.0  # after which an event expires
_FIRST_PAUSE, _LONGEST_PAUSE = 1, 60  # seconds before the next attempt
_CLOSE_SECONDS = 2.0
_QOS = 1
_SHORT_SECONDS = 15.0  # a shorter connection counts as failed
_TAKEN_OVER = 0x8E
_LONGEST_PASSWORD = 4096  # bytes
_LARGEST_CERTIFICATE = 8 << 20  # bytes; the CA bundle of a machine has half a megabyte

Received = Callable[[mqtt.MQTTMessage], None]


class Connection:
    """MQTT connection that publishes retained values and transient events.

    Publishing never blocks: the newest value of each topic is stored and published once there is a
    connection; an event is dropped when it is a minute old.

    Raise `BridgeError` if a file of the settings cannot be used.
    """

    def __init__(  # noqa: PLR0913
        self,
        settings: MqttSettings,
        client_id: str,
        alive_topic: str,
        report: Report,
        *,
        subscriptions: Sequence[str],
        received: Received,
    ) -> None:
        self._report = report
        self._alive = alive_topic
        self._subscriptions = subscriptions
        self._received = received
        self._client_id = client_id
        self._broker = broker_address(settings)
        self._hint = ""
        self._connected: float | None = None  # time of connection, by CLOCK_MONOTONIC
        self._is_refused = False  # by the broker, which then closes the connection
        self._short = 0  # consecutive short connections
        self._values: dict[str, str] = {}  # newest retained value of each topic
        self._unsent: dict[str, None] = {}  # topics, in order
        self._events: deque[tuple[float, str, str]] = deque(maxlen=_QUEUED)
        self._sent: tuple[float, mqtt.MQTTMessageInfo] | None = None  # time and last event
        self._last_kept: mqtt.MQTTMessageInfo | None = None  # the last published value
        self._delivering: dict[tuple[str, str], mqtt.MQTTMessageInfo] = {}
        self._ready_at = math.inf  # by CLOCK_MONOTONIC: when retained messages have arrived
        self._has_mark = False  # the broker has sent `online` back, after retained messages
        self._is_new = False  # nothing has been published on this connection yet
        self._client = self._make_client(settings)

    def is_ready(self) -> bool:
        """Whether the broker is connected, and has sent its retained messages."""
        return self._client.is_connected() and time.monotonic() >= self._ready_at

    def keep(self, topic: str, value: str) -> None:
        """Publish a retained value, unless it equals the last value of the topic."""
        if self._values.get(topic) != value:
            self._values[topic] = value
            self._unsent[topic] = None

    def forget(self, topic: str) -> None:
        """Clear the retained value of a topic."""
        self.keep(topic, "")

    def send(self, topic: str, payload: str) -> None:
        """Publish an event now or within a minute; drop the event after that."""
        self._events.append((time.monotonic(), topic, payload))

    def deliver(self, topic: str, payload: str) -> bool:
        """Publish a message that must arrive; call again until it returns True (acknowledged)."""
        key = topic, payload
        info = self._delivering.get(key)
        try:
            if info is not None and info.is_published():
                del self._delivering[key]
                return True
            if info is None and self.is_ready():
                self._delivering[key] = self._client.publish(topic, payload, _QOS)
        except (RuntimeError, ValueError):  # full queue
            del self._delivering[key]
        return False

    def repeat(self) -> None:
        """Publish all values again at the next `flush`, except cleared ones."""
        values = (topic for topic, value in self._values.items() if value)
        self._unsent = dict.fromkeys([*self._unsent, *values])

    def is_taken(self) -> bool:
        """Whether the broker has acknowledged all values."""
        if self._unsent or self._last_kept is None:
            return not self._unsent
        with suppress(RuntimeError, ValueError):
            return self._last_kept.is_published()
        return False

    def flush(self) -> None:
        """Publish all waiting values and events, if the connection is ready."""
        if not self.is_ready():
            return
        if self._is_new:
            self._is_new = False
            self.repeat()
        for topic in list(self._unsent):
            if not self._publish(topic, self._values[topic], retain=True):
                return
            del self._unsent[topic]
        while self._events and self._is_answering():
            queued, topic, payload = self._events[0]
            timely = time.monotonic() - queued <= _TIMELY_SECONDS
            if timely and not self._publish(topic, payload, retain=False):
                return
            self._events.popleft()

    def _is_answering(self) -> bool:
        """Whether the broker acknowledges events in time; if not, further ones would be late."""
        if self._sent is None:
            return True
        when, info = self._sent
        with suppress(RuntimeError, ValueError):
            return info.is_published() or time.monotonic() - when < _ANSWER_SECONDS
        return False

    def close(self) -> None:
        """Publish `offline`, and disconnect."""
        if self._client.is_connected():
            info = self._client.publish(self._alive, "offline", _QOS, retain=True)
            with suppress(RuntimeError, ValueError):  # connection lost: the broker sends the will
                info.wait_for_publish(_CLOSE_SECONDS)
        self._client.disconnect()
        self._client.loop_stop()
        # Otherwise the socket pair that wakes the loop is left to the garbage collector, which
        # warns if it finalises the pair before the client.
        self._client._reset_sockets()  # noqa: SLF001  no public call does only this

    def _make_client(self, settings: MqttSettings) -> mqtt.Client:
        settings.check_files()
        client = mqtt.Client(
            CallbackAPIVersion.VERSION2, client_id=self._client_id, protocol=mqtt.MQTTv5
        )
        client.will_set(self._alive, "offline", _QOS, retain=True)
        client.max_queued_messages_set(_QUEUED)
        client.reconnect_delay_set(_FIRST_PAUSE, _LONGEST_PAUSE)
        if settings.user:
            client.username_pw_set(settings.user, read_password(settings))
        if settings.tls:
            client.tls_set_context(tls_context(settings))
            if settings.certificate_file is None:
                self._hint = (
                    "; does it need a client certificate? see certificate_file and key_file"
                )
        client.on_connect = self._on_connect
        client.on_connect_fail = self._on_connect_fail
        client.on_disconnect = self._on_disconnect
        client.on_publish = self._on_publish
        client.on_subscribe = self._on_subscribe
        client.on_message = self._on_message
        client.connect_async(settings.host, _port(settings), _KEEPALIVE)
        client.loop_start()
        return client

    def _publish(self, topic: str, payload: str, *, retain: bool) -> bool:
        """Pass a message to the client; return False if the message has to wait."""
        properties = Properties(PacketTypes.PUBLISH)
        if not retain:
            properties.MessageExpiryInterval = round(_TIMELY_SECONDS)
        info = self._client.publish(topic, payload, _QOS, retain=retain, properties=properties)
        if retain:
            self._last_kept = info
        else:
            self._sent = time.monotonic(), info
        return info.rc in {mqtt.MQTT_ERR_SUCCESS, mqtt.MQTT_ERR_NO_CONN}  # NO_CONN: queued

    def _on_connect(
        self, client: mqtt.Client, _data: Any, _flags: Any, reason: ReasonCode, _more: Any
    ) -> None:
        if reason.is_failure:
            self._report(
                f"{self._broker}: refused: {reason}; see user, password_file and client_id"
            )
            self._is_refused = True
            return
        self._is_refused = False
        self._connected = time.monotonic()
        self._sent = None
        if self._subscriptions:
            topics = *self._subscriptions, self._alive
            client.subscribe([(topic, _QOS) for topic in topics])
        self._has_mark = False
        client.publish(self._alive, "online", _QOS, retain=True)
        self._is_new = True
        self._ready_at = self._connected
        if self._subscriptions:
            self._ready_at += _MOST_KEPT_SECONDS

    def _on_connect_fail(self, _client: mqtt.Client, _data: Any) -> None:
        error = sys.exc_info()[1]  # paho calls this while handling the exception
        if isinstance(error, ssl.SSLCertVerificationError):
            what = f"its certificate is refused: {error.verify_message}; see ca_file"
        else:
            what = str(getattr(error, "strerror", None) or error)
        self._report(f"{self._broker}: no broker ({what}); trying again")

    def _on_disconnect(
        self, client: mqtt.Client, _data: Any, _flags: Any, reason: ReasonCode, _more: Any
    ) -> None:
        since, self._connected = self._connected, None
        self._ready_at = math.inf
        if since is None:
            if reason.is_failure and not self._is_refused:  # a refusal is reported already
                self._report(f"{self._broker}: no connection: {reason}{self._hint}; trying again")
            self._is_refused = False
            return
        is_short = reason.is_failure and time.monotonic() - since < _SHORT_SECONDS
        self._short = self._short + 1 if is_short else 0
        # The client resets its own pause to the first one after each successful connection.
        pause = min(_FIRST_PAUSE << self._short, _LONGEST_PAUSE)
        client.reconnect_delay_set(pause, max(pause, _LONGEST_PAUSE))
        if reason.value == _TAKEN_OVER or self._short > 1:
            self._report(
                f"{self._broker}: the broker ends each connection at once: is another client named "
                f"{self._client_id} running, a second bridge? give one of them another client_id"
            )
        elif reason.is_failure:
            self._report(f"{self._broker}: the connection ended: {reason}; trying again")

    def _on_publish(
        self, _client: mqtt.Client, _data: Any, _number: int, reason: ReasonCode, _more: Any
    ) -> None:
        if reason.is_failure:
            self._report(
                f"{self._broker}: a message was refused: {reason}; the broker must let this client "
                f"write below {self._alive.rpartition('/')[0]}, and for Home Assistant below "
                "its discovery topic"
            )

    def _on_subscribe(
        self, _client: mqtt.Client, _data: Any, _number: int, reasons: list[ReasonCode], _more: Any
    ) -> None:
        if reasons[-1].is_failure:  # the broker will not send `online` back
            self._has_mark = True
            self._wait_for_kept()
        for topic, reason in zip(self._subscriptions, reasons, strict=False):
            if reason.is_failure:
                self._report(f"{self._broker}: may not read {topic}: {reason}")

    def _on_message(self, _client: mqtt.Client, _data: Any, message: mqtt.MQTTMessage) -> None:
        if message.topic == self._alive:
            self._has_mark = self._has_mark or not message.retain
        else:
            self._received(message)
        if message.retain or message.topic == self._alive:
            self._wait_for_kept()

    def _wait_for_kept(self) -> None:
        """Become ready shortly, once `online` has come back after the retained messages."""
        since = self._connected
        if since is not None and self._has_mark:
            self._ready_at = min(time.monotonic() + _KEPT_SECONDS, since + _MOST_KEPT_SECONDS)


def broker_address(settings: MqttSettings) -> str:
    """Return the host and port of a broker as text."""
    return f"{settings.host}:{_port(settings)}"


def _port(settings: MqttSettings) -> int:
    return settings.port or (8883 if settings.tls else 1883)


def tls_context(settings: MqttSettings) -> ssl.SSLContext:
    """Return the TLS context of a connection, with the configured certificates.

    Raise `BridgeError` if a file cannot be used.
    """
    ca, certificate, key = settings.ca_file, settings.certificate_file, settings.key_file
    paths = [path for path in (ca, certificate, key) if path is not None]
    for path in paths:
        read_limited(path, "certificate", _LARGEST_CERTIFICATE, BridgeError)  # a pipe would hang
    try:
        context = ssl.create_default_context(cafile=ca)
        if ca is not None:
            # Python 3.13 requires extensions that hand-made authorities lack, such as those made
            # by the Mosquitto manual.
            context.verify_flags &= ~ssl.VERIFY_X509_STRICT
        if certificate is not None:
            context.load_cert_chain(certificate, key, password=_no_password)
    except (OSError, ValueError) as error:
        files = ", ".join(map(str, paths))
        what = getattr(error, "strerror", None) or error
        raise BridgeError(f"bridge.mqtt: {files}: no certificates of use ({what})") from error
    return context


def _no_password() -> str:
    raise ValueError("the key is encrypted; save it without a password")


def read_password(settings: MqttSettings) -> str | None:
    """Read the password of the broker's user; None if not configured.

    Raise `BridgeError` if the password file cannot be used.
    """
    if settings.password_file is None:
        return None
    path = secret_path(settings.password_file)
    data = read_limited(path, "password file", _LONGEST_PASSWORD, BridgeError)
    try:
        return data.decode().split("\n", 1)[0].rstrip("\r")
    except UnicodeDecodeError:
        raise BridgeError(f"{path}: holds no text in UTF-8") from None
