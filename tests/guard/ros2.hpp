// Stands for ROS 2 where that is not at hand: of rclcpp and std_msgs as much as examples/ros2 uses.
// It plays a script: "topic numbers" is told to whoever subscribes to it, "tick" is the timer.
#pragma once

#include <chrono>
#include <cstdarg>
#include <cstdio>
#include <functional>
#include <iostream>
#include <map>
#include <memory>
#include <sstream>
#include <string>
#include <utility>
#include <vector>

namespace std_msgs::msg {
struct Empty {};
struct Float64 {
  double data = 0.0;
};
struct Float64MultiArray {
  std::vector<double> data;
};
struct Int32 {
  int data = 0;
};
inline void read(Empty&, const std::vector<double>&) {}
inline void read(Float64MultiArray& into, const std::vector<double>& numbers) { into.data = numbers; }
inline std::ostream& operator<<(std::ostream& out, const Float64& of) { return out << of.data; }
inline std::ostream& operator<<(std::ostream& out, const Int32& of) { return out << of.data; }
inline std::ostream& operator<<(std::ostream& out, const Float64MultiArray& of) {
  for (const double number : of.data) out << number << ' ';
  return out;
}
}  // namespace std_msgs::msg

namespace rclcpp {
using Told = std::function<void(const std::vector<double>&)>;
inline std::map<std::string, Told> subscribed;

template <typename Message>
struct Publisher {
  using SharedPtr = std::shared_ptr<Publisher>;
  std::string topic;
  void publish(const Message& message) { std::cout << topic << ' ' << message << '\n'; }
};
template <typename Message>
struct Subscription {
  using SharedPtr = std::shared_ptr<Subscription>;
};
struct TimerBase {
  using SharedPtr = std::shared_ptr<TimerBase>;
};
struct Clock {
  using SharedPtr = std::shared_ptr<Clock>;
};
struct Logger {};

class Node {
 public:
  using SharedPtr = std::shared_ptr<Node>;
  explicit Node(const std::string&) {}
  virtual ~Node() = default;
  Clock::SharedPtr get_clock() { return std::make_shared<Clock>(); }
  Logger get_logger() const { return {}; }
  template <typename Message>
  typename Publisher<Message>::SharedPtr create_publisher(const std::string& topic, int) {
    return std::make_shared<Publisher<Message>>(Publisher<Message>{topic});
  }
  template <typename Message, typename Callback>
  typename Subscription<Message>::SharedPtr create_subscription(const std::string& topic, int,
                                                                Callback callback) {
    subscribed[topic] = [callback](const std::vector<double>& numbers) {
      Message message;
      read(message, numbers);
      callback(message);
    };
    return std::make_shared<Subscription<Message>>();
  }
};

template <typename Callback>
TimerBase::SharedPtr create_timer(Node*, Clock::SharedPtr, std::chrono::nanoseconds,
                                  Callback callback) {
  subscribed["tick"] = [callback](const std::vector<double>&) { callback(); };
  return std::make_shared<TimerBase>();
}

inline void init(int, char**) { std::cout.precision(17); }
inline void shutdown() {}
inline void spin(const Node::SharedPtr&) {
  std::string line, topic, number;
  while (std::getline(std::cin, line)) {
    std::istringstream words(line);
    std::vector<double> numbers;
    for (words >> topic; words >> number;) numbers.push_back(std::stod(number));
    subscribed.at(topic)(numbers);
  }
}
}  // namespace rclcpp

#define RCLCPP_ERROR(logger, ...) ((void)(logger), std::printf("error "), std::printf(__VA_ARGS__), std::puts(""))
