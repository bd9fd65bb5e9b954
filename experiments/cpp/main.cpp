// Run an exported scorer in ONNX Runtime, and compare its outputs with those in the folder.
//
//     exported_scorer FOLDER [TOLERANCE]
//
// Prints the scores and the largest difference. Exits with 1 if the difference is above the tolerance.

#include <onnxruntime_cxx_api.h>

#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <cstring>
#include <fstream>
#include <iostream>
#include <iterator>
#include <stdexcept>
#include <string>
#include <vector>

// Values of an array in NumPy's .npy format: 8 bytes of magic, 2 bytes of header length, the header, the values.
std::vector<char> read_array(const std::string& path) {
  std::ifstream file(path, std::ios::binary);
  std::vector<char> bytes{std::istreambuf_iterator<char>(file), {}};
  if (bytes.size() < 10 || std::memcmp(bytes.data(), "\x93NUMPY\x01", 7) != 0)
    throw std::runtime_error(path + ": expected an array in NumPy's format 1.0");
  const auto length = static_cast<unsigned char>(bytes[8]) + 256u * static_cast<unsigned char>(bytes[9]);
  if (bytes.size() < 10 + length) throw std::runtime_error(path + ": expected a whole file");
  return {bytes.begin() + 10 + length, bytes.end()};
}

// Largest difference, relative to values above 1; two NaN are equal.
float largest_difference(const float* values, const std::vector<float>& expected) {
  float largest = 0;
  for (size_t i = 0; i < expected.size(); ++i) {
    if (std::isnan(values[i]) && std::isnan(expected[i])) continue;
    const float difference = std::abs(values[i] - expected[i]) / std::max(std::abs(expected[i]), 1.0f);
    largest = std::isnan(difference) ? INFINITY : std::max(largest, difference);
  }
  return largest;
}

int run(const std::string& folder, float tolerance) {
  Ort::Env env(ORT_LOGGING_LEVEL_ERROR, "exported_scorer");
  Ort::Session session(env, (folder + "/program.onnx").c_str(), Ort::SessionOptions{});
  Ort::AllocatorWithDefaultOptions allocator;
  const auto memory = Ort::MemoryInfo::CreateCpu(OrtArenaAllocator, OrtMemTypeDefault);

  std::vector<std::string> names;
  std::vector<std::vector<char>> arrays;  // the tensors use their memory
  std::vector<Ort::Value> inputs;
  for (size_t i = 0; i < session.GetInputCount(); ++i) {
    names.emplace_back(session.GetInputNameAllocated(i, allocator).get());
    arrays.push_back(read_array(folder + "/check/" + names.back() + ".npy"));
    const auto type = session.GetInputTypeInfo(i);
    const auto tensor = type.GetTensorTypeAndShapeInfo();
    const auto shape = tensor.GetShape();
    inputs.push_back(Ort::Value::CreateTensor(memory, arrays.back().data(), arrays.back().size(), shape.data(),
                                              shape.size(), tensor.GetElementType()));
  }
  const size_t num_inputs = names.size();
  for (size_t i = 0; i < session.GetOutputCount(); ++i)
    names.emplace_back(session.GetOutputNameAllocated(i, allocator).get());
  std::vector<const char*> pointers;
  for (const auto& name : names) pointers.push_back(name.c_str());

  const auto outputs = session.Run(Ort::RunOptions{}, pointers.data(), inputs.data(), num_inputs,
                                   pointers.data() + num_inputs, names.size() - num_inputs);

  float largest = 0;
  for (size_t i = 0; i < outputs.size(); ++i) {
    const std::string& name = names[num_inputs + i];
    const auto bytes = read_array(folder + "/check/" + name + ".npy");
    std::vector<float> expected(bytes.size() / sizeof(float));
    std::memcpy(expected.data(), bytes.data(), expected.size() * sizeof(float));
    const float* values = outputs[i].GetTensorData<float>();
    if (outputs[i].GetTensorTypeAndShapeInfo().GetElementCount() != expected.size())
      throw std::runtime_error(name + ": expected as many numbers as in the folder");
    std::cout << name << ":";
    for (size_t k = 0; k < std::min<size_t>(expected.size(), 10); ++k) std::cout << " " << values[k];
    std::cout << "\n";
    largest = std::max(largest, largest_difference(values, expected));
  }
  std::cout << "largest difference: " << largest << " (tolerance " << tolerance << ")\n";
  return largest <= tolerance ? 0 : 1;
}

int main(int argc, char** argv) {
  if (argc < 2) {
    std::cerr << "usage: exported_scorer FOLDER [TOLERANCE]\n";
    return 2;
  }
  try {
    return run(argv[1], argc > 2 ? std::strtof(argv[2], nullptr) : 1e-4f);
  } catch (const std::exception& error) {
    std::cerr << error.what() << "\n";
    return 2;
  }
}
