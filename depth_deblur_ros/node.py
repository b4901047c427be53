"""
The live node: topics in, topics out. The only file that knows rclpy.

A managed node that configures and activates itself. Callbacks hand over to the pipeline, whose
worker publishes the results, at the stamp of their image.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import Field
from functools import partial
import os
import signal
import threading
import time
from typing import Any

from depth_deblur_ros.compiling import tell_of_compiling
from depth_deblur_ros.core.data import InputError
from depth_deblur_ros.core.solver import deblur
from depth_deblur_ros.frames import SolvedPair
from depth_deblur_ros.health import OK, Said, Stream
from depth_deblur_ros.live import compile_kernels, end_work
from depth_deblur_ros.memory import keep_freed_memory
from depth_deblur_ros.messages import compressed_fields, Fields, filled, stamp_ns
from depth_deblur_ros.pipeline import Pipeline
from depth_deblur_ros.results import COMPRESSED, DEPTH, IMAGE, LIVE_TYPES
from depth_deblur_ros.settings import DECLARED, READ_ONLY, Settings, settings_from
from depth_deblur_ros.tracking import Solver
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import TwistStamped, TwistWithCovarianceStamped
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
import rclpy
from rclpy.clock import Clock, ClockType, JumpThreshold
from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.qos import qos_policy_name_from_kind, QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, Imu
from std_msgs.msg import Float32

NAME = 'depth_deblur'
QUEUE = 10  # messages per topic, in and out
INACTIVE, TIME_JUMP = 'the node was deactivated', 'ROS time jumped back'
IDLE, CHANGED = 'the last subscriber left', 'the input topics were changed'
PICTURES = (IMAGE, DEPTH, COMPRESSED)
DONE, REFUSED = 0, 2  # exit codes
PATIENCE_S = 0.5  # for the frame that is being solved at the end
_CLASSES: dict[str, Any] = {
    f'{kind.__module__.split(".")[0]}/msg/{kind.__name__}': kind
    for kind in (
        *(CameraInfo, CompressedImage, DiagnosticStatus, Float32, Image, Imu),
        *(TwistStamped, TwistWithCovarianceStamped),
    )
}
_POLICIES = [QoSPolicyKind[name] for name in ('HISTORY', 'DEPTH', 'RELIABILITY', 'DURABILITY')]
_OVERRIDES = QoSOverridingOptions(_POLICIES)


class DeblurNode(LifecycleNode):  # type: ignore[misc]
    """Topics to the pipeline, results to topics."""

    def __init__(
        self, solve: Solver = deblur, first: Callable[[], None] = compile_kernels, **options: Any
    ) -> None:
        super().__init__(NAME, **options)
        self._solve, self._first = solve, first
        self._active = False
        self._pipeline: Pipeline | None = None  # while configured
        self._inputs: list[Any] = []
        self._said = Said()
        self._outputs: dict[str, Any] = {}
        self._settings = self._accepted = self._declare()
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._slop_timer = self.create_timer(1.0, self._settle, clock=steady)
        self._diagnostics = self.create_publisher(DiagnosticArray, '/diagnostics', QUEUE)
        self.create_timer(1.0, self._tick, clock=steady)
        backward = JumpThreshold(min_forward=None, min_backward=Duration(nanoseconds=-1))
        self._jumps = self.get_clock().create_jump_callback(
            backward, post_callback=lambda _: self._clear(TIME_JUMP)
        )
        self.add_on_set_parameters_callback(self._check)
        self.add_post_set_parameters_callback(lambda _: self._apply())

    def autostart(self) -> None:
        """Configure and activate, unless told to wait; refuse what does not allow it."""
        steps = (self.trigger_configure, self.trigger_activate)
        for step in steps if self._settings.node.autostart else ():
            if step() != TransitionCallbackReturn.SUCCESS:
                raise InputError('the node cannot start as it is told to')

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Make the publishers and the worker."""
        return self._step(self._configure)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Take messages in."""
        self._active = True
        return self._step(self._refresh)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Take in and publish nothing more."""
        self._active = False
        return self._step(partial(self._unsubscribe, INACTIVE))

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Free what configuring has made."""
        return self._step(self.release)

    on_shutdown = on_cleanup

    def release(self) -> None:
        """Stop the work, without a word about the frame at hand; remove the publishers."""
        self._active = False
        self._unsubscribe(INACTIVE)
        if self._pipeline:
            self._pipeline.stop()
            self._pipeline = None
        for output in self._outputs.values():
            self.destroy_publisher(output)
        self._outputs = {}

    def _step(self, change: Callable[[], None]) -> TransitionCallbackReturn:
        try:
            change()
        except Exception as error:  # rclpy would swallow it
            self._active = False
            self.get_logger().error(f'{type(error).__name__}: {error}')
            return TransitionCallbackReturn.FAILURE
        return TransitionCallbackReturn.SUCCESS

    def _configure(self) -> None:
        self.release()  # what an earlier attempt left
        for topic, kind in LIVE_TYPES.items():
            self._outputs[topic] = self.create_publisher(
                _CLASSES[kind],
                topic,
                QoSProfile(depth=QUEUE, reliability=ReliabilityPolicy.RELIABLE),
                event_callbacks=PublisherEventCallbacks(matched=lambda _: self._refresh()),
                qos_overriding_options=_OVERRIDES,
            )
        self._pipeline = Pipeline(self._settings, self, self._solve, self._first)

    def _declare(self) -> Settings:
        declared = [(knob.name, knob.default, _descriptor(knob)) for knob in DECLARED]
        found = self.declare_parameters('', declared)
        return settings_from({parameter.name: parameter.value for parameter in found})

    def _check(self, changed: Sequence[Parameter]) -> SetParametersResult:
        """Accept or reject a change."""
        try:
            values = {parameter.name: parameter.value for parameter in changed}
            self._accepted = settings_from(values, self._settings)
        except InputError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _apply(self) -> None:
        """Let what was accepted count from the next frame on."""
        before, self._settings = self._settings, self._accepted
        if before is self._settings:
            return  # a parameter of ROS itself
        if self._pipeline:
            self._pipeline.use(self._settings)
        if self._inputs and before.sources() != self._settings.sources():
            self._unsubscribe(CHANGED)
        self._refresh()

    def _refresh(self) -> None:
        """Take messages in while there is somebody to work for."""
        if not self._active:
            return
        wanted = not self._settings.node.lazy or any(map(self._is_heard, self._outputs))
        if wanted and not self._inputs:
            self._subscribe()
        elif not wanted and self._inputs:
            self._unsubscribe(IDLE)

    def _is_heard(self, topic: str) -> bool:
        output = self._outputs.get(topic)
        return bool(output and output.get_subscription_count() > 0)

    def _subscribe(self) -> None:
        assert self._pipeline
        self._pipeline.begin()
        sources, streams = self._settings.sources(), {}
        for role, source in sources.items():
            name = self.resolve_topic_name(source.topic) + source.suffix
            streams[role] = self._pipeline.stream(role, name, source.needed)
        for role in reversed(sources):  # of what waits, the first made is taken first: not images
            kind = _CLASSES[sources[role].kind]
            self._inputs.append(self._listen(role, streams[role], kind))

    def _listen(self, role: str, stream: Stream, kind: Any) -> Any:
        def mismatch(event: Any) -> None:
            stream.mismatch = qos_policy_name_from_kind(event.last_policy_kind)

        return self.create_subscription(
            kind,
            stream.topic,
            partial(self._take, role, stream),
            QoSProfile(depth=QUEUE, reliability=ReliabilityPolicy.BEST_EFFORT),
            event_callbacks=SubscriptionEventCallbacks(
                incompatible_qos=mismatch,
                message_lost=lambda event: stream.miss(event.total_count_change),
                matched=lambda event: stream.match(event.current_count),
            ),
            qos_overriding_options=_OVERRIDES,
        )

    def _take(self, role: str, stream: Stream, msg: Any, info: dict[str, Any]) -> None:
        stream.follow(info.get('publication_sequence_number'))
        if self._pipeline:
            self._pipeline.take(role, msg, info.get('received_timestamp'))
            if self._pipeline.undecided and self._slop_timer.is_canceled():
                slop_s = self._settings.node.sync_slop_s
                self._slop_timer.timer_period_ns = max(1_000_000, round(slop_s * 1e9))
                self._slop_timer.reset()

    def _settle(self) -> None:
        if not (self._pipeline and self._pipeline.settle()):
            self._slop_timer.cancel()

    def _unsubscribe(self, reason: str) -> None:
        for entity in self._inputs:
            self.destroy_subscription(entity)
        self._inputs = []
        self._clear(reason)

    def _clear(self, reason: str) -> None:
        if self._pipeline:
            self._pipeline.clear(reason)

    def wants_pictures(self) -> bool:
        """Whether anybody looks at the images, or at the motion alone."""
        return any(map(self._is_heard, PICTURES))

    def publish(self, solved: SolvedPair) -> float:
        """Send what is said about a pair; give its age then [s]."""
        for topic, fields in solved.messages():
            if topic == IMAGE and self._is_heard(COMPRESSED):
                quality = self._settings.node.jpeg_quality
                self._send(COMPRESSED, compressed_fields(fields, quality))
            if topic not in PICTURES or self._is_heard(topic):
                self._send(topic, fields)
        now_ns = self.get_clock().now().nanoseconds
        return float(now_ns - stamp_ns(solved.pair.colour.header)) / 1e9

    def warn(self, text: str) -> None:
        """Tell the user, but the same only now and then."""
        if self.context.ok() and self._said.is_new(text, time.monotonic()):
            self.get_logger().warning(text)

    def _send(self, topic: str, fields: Fields) -> None:
        output = self._outputs[topic]
        output.publish(filled(output.msg_type(), fields, KeyValue))

    def _tick(self) -> None:
        self._refresh()
        name, state = f'{self.get_name()}: frames', 'idle: nobody subscribes'
        if not self._active:
            state = 'not active'
        status: Fields = {'level': OK, 'name': name, 'message': state}
        if self._pipeline:
            self._pipeline.count_publishers(self.count_publishers)
            status = self._pipeline.status(name, '' if self._inputs else state)
        if status['level'] != OK:
            self.warn(status['message'])
        message = DiagnosticArray(status=[filled(DiagnosticStatus(), status, KeyValue)])
        message.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(message)


def _descriptor(declared: Field[Any]) -> ParameterDescriptor:
    meta = declared.metadata
    descriptor = ParameterDescriptor(
        description=meta['help'], read_only=declared.name in READ_ONLY
    )
    if 'choices' in meta:
        descriptor.additional_constraints = f'one of {", ".join(meta["choices"])}'
    elif isinstance(declared.default, float):
        limits = FloatingPointRange(from_value=meta['low'], to_value=meta['high'])
        descriptor.floating_point_range = [limits]
    elif 'low' in meta:
        descriptor.integer_range = [IntegerRange(from_value=meta['low'], to_value=meta['high'])]
    return descriptor


def main(args: Sequence[str] | None = None, node_type: type[DeblurNode] = DeblurNode) -> int:
    """Run the node until it is told to stop."""
    told = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        # rclpy's own handler, set after this one, ends the spinning; nothing else may interrupt.
        signal.signal(number, lambda *_: told.set())
    keep_freed_memory()
    node, code = None, DONE
    try:
        rclpy.init(args=args)
        node = node_type()
        tell_of_compiling(node.get_logger().info)
        node.autostart()
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        executor.spin()
    except ExternalShutdownException:
        pass
    except (InputError, ParameterException, RuntimeError) as error:
        if not told.is_set():
            rclpy.logging.get_logger(NAME).fatal(' '.join(str(error).split()))
            code = REFUSED
    finally:
        if node:
            node.release()
            node.destroy_node()
        rclpy.try_shutdown()
    if not end_work(PATIENCE_S):
        os._exit(code)  # all that others hear of is closed; a solver cannot be interrupted
    return code
