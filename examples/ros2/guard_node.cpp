// A node of ROS 2 with a guard in it, between a controller and what it controls.
//
// It decides each EVOFSM_INTERVAL seconds, of the node's clock, on the latest `observation` and
// `proposal`, and publishes what is `executed`, its `risk`, and the `reason` as a code (evofsm.h).
// What did not come since the decision before is not known: without a proposal the guard falls back.
// `reset` begins an episode.
#include <algorithm>
#include <chrono>
#include <cmath>
#include <memory>

#include <rclcpp/rclcpp.hpp>
#include <std_msgs/msg/empty.hpp>
#include <std_msgs/msg/float64.hpp>
#include <std_msgs/msg/float64_multi_array.hpp>
#include <std_msgs/msg/int32.hpp>

#include "evofsm.hpp"

using std_msgs::msg::Empty;
using std_msgs::msg::Float64;
using std_msgs::msg::Float64MultiArray;
using std_msgs::msg::Int32;

class GuardNode : public rclcpp::Node {
 public:
  GuardNode() : Node("guard") {
    forget();
    executed_ = create_publisher<Float64MultiArray>("executed", 1);
    risk_ = create_publisher<Float64>("risk", 1);
    reason_ = create_publisher<Int32>("reason", 1);
    observations_ = create_subscription<Float64MultiArray>(
        "observation", 1, [this](const Float64MultiArray& seen) { take(seen, observation_); });
    proposals_ = create_subscription<Float64MultiArray>(
        "proposal", 1, [this](const Float64MultiArray& wanted) { take(wanted, proposal_); });
    resets_ = create_subscription<Empty>("reset", 1, [this](const Empty&) {
      guard_.reset();
      forget();
    });
    const std::chrono::duration<double> interval(EVOFSM_INTERVAL);
    timer_ = rclcpp::create_timer(
        this, get_clock(), std::chrono::duration_cast<std::chrono::nanoseconds>(interval),
        [this] { decide(); });
  }

 private:
  void forget() {
    observation_.fill(NAN);
    proposal_.fill(NAN);
  }

  template <typename Numbers>
  void take(const Float64MultiArray& message, Numbers& into) {
    if (message.data.size() != into.size()) {
      RCLCPP_ERROR(get_logger(), "%zu numbers came where %zu belong", message.data.size(),
                   into.size());
      return;
    }
    std::copy(message.data.begin(), message.data.end(), into.begin());
  }

  void decide() {
    const auto decision = guard_.decide(observation_, proposal_);
    forget();
    if (!decision) {
      RCLCPP_ERROR(get_logger(), "no decision: the observation is infinite, or NaN is rejected");
      return;
    }
    Float64MultiArray executed;
    executed.data.assign(decision->executed, decision->executed + EVOFSM_ACTIONS);
    executed_->publish(executed);
    Float64 risk;
    risk.data = decision->risk_executed;
    risk_->publish(risk);
    Int32 reason;
    reason.data = decision->reason;
    reason_->publish(reason);
  }

  evofsm::Guard guard_;
  evofsm::Observation observation_;
  evofsm::Action proposal_;
  rclcpp::Publisher<Float64MultiArray>::SharedPtr executed_;
  rclcpp::Publisher<Float64>::SharedPtr risk_;
  rclcpp::Publisher<Int32>::SharedPtr reason_;
  rclcpp::Subscription<Float64MultiArray>::SharedPtr observations_, proposals_;
  rclcpp::Subscription<Empty>::SharedPtr resets_;
  rclcpp::TimerBase::SharedPtr timer_;
};

int main(int argc, char** argv) {
  rclcpp::init(argc, argv);
  rclcpp::spin(std::make_shared<GuardNode>());
  rclcpp::shutdown();
  return 0;
}
